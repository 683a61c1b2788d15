// Drives blend shapes in Unity by what tonguetrack sends: put this on an object with a SkinnedMeshRenderer.
//
//     tonguetrack live SOURCE --to 'osc://127.0.0.1:9000?rate=60&send=shapes'     names of ours, and pose_0, pose_1, ...
//     tonguetrack live SOURCE --to 'vmc://127.0.0.1:9000?preset=arkit'            names of a preset
//
// Blend shapes with those names follow, whatever else the mesh has. A tongue that tonguetrack exported as glTF has pose_0,
// pose_1, ...: import it with glTFast. No other package is needed. A thread listens, the newest value of each name wins.

using System;
using System.Collections.Generic;
using System.Net;
using System.Net.Sockets;
using System.Text;
using System.Threading;
using UnityEngine;

public class TongueReceiver : MonoBehaviour
{
    public int port = 9000;
    public SkinnedMeshRenderer target;

    private const string Shape = "/tongue/shape/";
    private const string Blend = "/VMC/Ext/Blend/Val";

    private readonly Dictionary<string, float> values = new Dictionary<string, float>();
    private readonly Dictionary<string, int> indices = new Dictionary<string, int>();
    private UdpClient client;
    private Thread listener;

    private void OnEnable()
    {
        if (target == null) target = GetComponent<SkinnedMeshRenderer>();
        for (int k = 0; k < target.sharedMesh.blendShapeCount; k++)
            indices[target.sharedMesh.GetBlendShapeName(k)] = k;
        client = new UdpClient(new IPEndPoint(IPAddress.Loopback, port));
        listener = new Thread(Listen) { IsBackground = true };
        listener.Start();
    }

    private void OnDisable()
    {
        client.Close(); // ends the thread, which waits in Receive
        listener.Join(1000);
    }

    private void Update()
    {
        lock (values)
            foreach (KeyValuePair<string, float> pair in values)
                if (indices.TryGetValue(pair.Key, out int index))
                    target.SetBlendShapeWeight(index, 100f * pair.Value); // Unity counts in percent
    }

    private void Listen()
    {
        IPEndPoint sender = null;
        while (true)
        {
            byte[] data;
            try { data = client.Receive(ref sender); }
            catch (SocketException) { return; }
            catch (ObjectDisposedException) { return; }
            try { Read(data, 0, data.Length); }
            catch (ArgumentException) { } // not OSC: the next one may be
            catch (IndexOutOfRangeException) { }
        }
    }

    // A message, or a bundle of them, in data[at..end).
    private void Read(byte[] data, int at, int end)
    {
        if (end - at >= 16 && data[at] == '#')
        {
            for (at += 16; at + 4 <= end;)
            {
                int size = Int(data, at);
                if (size <= 0 || size > end - at - 4) return;
                Read(data, at + 4, at + 4 + size);
                at += 4 + size;
            }
            return;
        }
        string address = Text(data, ref at);
        string tags = Text(data, ref at);
        string name = null;
        if (address.StartsWith(Shape, StringComparison.Ordinal) && tags == ",f") name = address.Substring(Shape.Length);
        if (address == Blend && tags == ",sf") name = Text(data, ref at);
        if (name == null) return;
        float value = BitConverter.ToSingle(BitConverter.GetBytes(Int(data, at)), 0);
        lock (values) values[name] = value;
    }

    // OSC is big-endian.
    private static int Int(byte[] data, int at)
    {
        return data[at] << 24 | data[at + 1] << 16 | data[at + 2] << 8 | data[at + 3];
    }

    // A text ends with a zero, and zeros fill it to four bytes.
    private static string Text(byte[] data, ref int at)
    {
        int end = Array.IndexOf(data, (byte)0, at);
        if (end < 0) throw new ArgumentException("a text does not end");
        string text = Encoding.UTF8.GetString(data, at, end - at);
        at = end + 4 - end % 4;
        return text;
    }
}
